"""A sweep's rows, one by one by the host; its files; what it does when it is stopped."""

import jax
import numpy as np
import pyarrow.parquet
import pytest
from sweeps import GRID, LAW, WORLDS, rows_of, small_sweep

import pcm_jax
from pcm_jax.consistency import chi2_gate, squared_mahalanobis
from pcm_jax.errors import InputError
from pcm_jax.evaluation import false_positive_rate, precision, true_positive_rate
from pcm_jax.selection import select_from
from pcm_jax.simulation import simulate_chains

CLOSURES = 12
METHODS_OF_PCM = "exact", "heuristic"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The rows of a sweep that nothing stopped."""
    return rows_of(small_sweep(tmp_path_factory.mktemp("sweep"), progress=lambda *_: None))


@pytest.mark.slow
def test_rows_are_what_the_host_finds(whole):
    """World by world: the key that names it, the host's method on its Q, metrics in NumPy."""
    draw = jax.jit(lambda key: simulate_chains(key, **LAW))
    rows = whole.to_pylist()
    each = [(method, p) for method in GRID["methods"] for p in GRID["confidences"]]
    assert len(rows) == WORLDS * len(each)
    for number in (0, 1, 63, 64, WORLDS - 1):
        world = draw(jax.random.fold_in(jax.random.key(GRID["seed"]), number))
        squared, inliers = np.asarray(squared_mahalanobis(world.problem)), np.asarray(world.is_true)
        for row, (method, confidence) in zip(rows[number * len(each) :], each, strict=False):
            kept = select_from(squared, float(chi2_gate(confidence, 3)), method=method)
            assert row == {
                "seed": 7,
                "world": number,
                "method": method,
                "confidence": confidence,
                "closures": CLOSURES,
                "inliers": 4,
                "accepted": kept.sum(),
                "accepted_inliers": (kept & inliers).sum(),
                "true_positive_rate": true_positive_rate(kept, inliers),
                "false_positive_rate": false_positive_rate(kept, inliers),
                "precision": precision(kept, inliers),
                "status": "ok",
            }


@pytest.mark.slow
def test_methods_do_what_they_should(whole):
    frame = {name: np.array(whole[name].to_pylist()) for name in whole.column_names}
    wide = frame["confidence"] == 0.99
    for method in GRID["methods"]:
        of_method = frame["method"] == method
        assert frame["true_positive_rate"][of_method & wide].mean() > 0.6  # 3 aliased against 4
        assert frame["false_positive_rate"][of_method & wide].mean() < 0.1
    exact, heuristic = (frame["accepted"][frame["method"] == f"pcm-{k}"] for k in METHODS_OF_PCM)
    assert (heuristic <= exact).all()
    narrow, wide = exact.reshape(-1, 2).T
    assert (narrow <= wide).all()
    assert (narrow < wide).mean() > 0.3


@pytest.mark.slow
def test_a_stopped_sweep_goes_on(whole, tmp_path):
    """By a process that is killed, and in batches of another size: test_several_devices."""

    class StoppedError(Exception):
        pass

    def stop(stage, done, worlds):
        raise StoppedError

    with pytest.raises(StoppedError):
        small_sweep(tmp_path, progress=stop)
    (part,) = tmp_path.iterdir()
    assert part.name == "worlds-0000000000-0000000064.parquet"
    (tmp_path / ".worlds-0000000064-0000000128.parquet.1").write_bytes(b"half")  # killed in writing
    before, seen = part.stat().st_mtime_ns, []
    small_sweep(tmp_path, progress=lambda stage, *done: seen.append(done))
    assert seen == [(128, WORLDS), (192, WORLDS), (WORLDS, WORLDS)]
    assert part.stat().st_mtime_ns == before
    assert rows_of(tmp_path).equals(whole)
    small_sweep(tmp_path, progress=stop)  # nothing is left to do


@pytest.mark.slow
def test_holes_are_filled_and_worlds_added(whole, tmp_path):
    small_sweep(tmp_path, worlds=64)
    small_sweep(tmp_path, worlds=WORLDS)
    (tmp_path / "worlds-0000000064-0000000128.parquet").unlink()
    small_sweep(tmp_path)
    assert rows_of(tmp_path).equals(whole)


def test_worlds_that_are_no_numbers_are_flagged(tmp_path):
    rows = rows_of(small_sweep(tmp_path, worlds=2, sigma_translation=1e200))
    assert set(rows["status"].to_pylist()) == {"not-finite"}
    assert set(rows["accepted"].to_pylist()) == {1}  # what agrees with nothing else


def test_the_same_program_serves_other_noise_gates_and_seeds(tmp_path):
    with jax.log_compiles(False):
        small_sweep(tmp_path / "a", worlds=64)
        from pcm_jax.experiments.sweep import _program

        before = _program.cache_info().misses
        changes = {"seed": 8, "sigma_rotation": 0.01, "confidences": (0.1, 0.9)}
        rows = rows_of(small_sweep(tmp_path / "b", worlds=64, **changes))
        assert _program.cache_info().misses == before
    assert not rows["accepted"].equals(rows_of(tmp_path / "a")["accepted"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"worlds": 0}, "worlds: 0 given"),
        ({"batch": 0}, "batch: 0 given"),
        ({"seed": 1 << 70}, "seed: .* expected an integer of 64 bits"),
        ({"methods": ("guess",)}, "methods: 'guess', expected some of pcm-exact, "),
        ({"methods": ()}, "expected one of each"),
        ({"confidences": (1.5,)}, "confidence: .* expected a probability"),
        ({"closures": 9}, "closures: not an argument of a sweep"),
        ({"reach": -1.0}, "reach: -1.0 given, expected a number above 0"),
        ({"methods": ("pcm-exact",), "random": 130}, "137 measurements, expected at most 128"),
    ],
)
def test_bad_arguments_are_named(changes, message, tmp_path):
    with pytest.raises(InputError, match=message):
        small_sweep(tmp_path, **changes)


def test_rows_of_two_sweeps_are_not_mixed(tmp_path):
    small_sweep(tmp_path, worlds=64)
    with pytest.raises(InputError, match=r"rows of another sweep, with seed 7; expected 8, or"):
        small_sweep(tmp_path, seed=8)
    (tmp_path / "worlds-0000000064-0000000128.parquet").write_bytes(b"no table")
    with pytest.raises(InputError, match=r"00128\.parquet: not a file of a sweep"):
        small_sweep(tmp_path)


def test_without_pyarrow_one_line_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(pyarrow.__dict__, "parquet", None)
    monkeypatch.setitem(__import__("sys").modules, "pyarrow.parquet", None)
    with pytest.raises(InputError, match=r"^pyarrow: not installed.* pip install '\.\[sweep\]'"):
        small_sweep(tmp_path / "never")
    assert not (tmp_path / "never").exists()


def test_it_is_a_name_of_the_package():
    assert pcm_jax.sweep is pcm_jax.experiments.sweep
