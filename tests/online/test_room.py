"""Arrays that grow at their end."""

import jaxlie
import numpy as np

from pcm_jax import lie
from pcm_jax.online._room import Room


def test_rows_are_not_copied_but_now_and_then():
    room, rows, moves = Room(), np.zeros((3, 2)), 0
    for k in range(500):
        before, rows = rows, room.behind("x", rows, np.full((1, 2), k))
        moves += before.base is not rows.base
    assert moves < 10
    np.testing.assert_array_equal(rows[3:, 0], np.arange(500))


def test_who_holds_fewer_rows_keeps_them():
    room = Room()
    first = room.behind("x", np.arange(3.0), [3.0])
    one = room.behind("x", first, [10.0])
    other = room.behind("x", first, [20.0])
    again = room.behind("x", one, [11.0])
    assert first.tolist() == [0, 1, 2, 3]
    assert one.tolist() == [0, 1, 2, 3, 10]
    assert other.tolist() == [0, 1, 2, 3, 20]
    assert again.tolist() == [0, 1, 2, 3, 10, 11]


def test_arrays_of_one_name_that_are_not_the_same_are_copied():
    room = Room()
    first = room.behind("x", np.arange(3), [3])
    other = room.behind("x", np.arange(4) * 2, [8])
    assert first.tolist() == [0, 1, 2, 3]
    assert other.tolist() == [0, 2, 4, 6, 8]
    assert room.behind("x", other, [0.5]).tolist() == [0, 2, 4, 6, 8, 0.5]


def test_transforms_keep_their_group(group):
    room = Room()
    before, new = (lie.identity(group, (count,)) for count in (2, 1))
    found = room.transforms_behind("poses", before, new)
    assert type(found) is group
    assert len(lie.parameters(found)) == 3
    assert isinstance(found, jaxlie.MatrixLieGroup)
