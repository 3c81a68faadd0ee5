"""Mistakes with something unknown in them: angles in degrees, a sensor's pose on its robot.

**Degrees.** An angle of so many degrees, taken for radians, has lost its whole turns: what was
read, φ, may have been any φ + 2πk degrees. Right closures share the heading of T = X z Y⁻¹, so
headings are tried by which a reading of each closure is nearby; each gives one reading of all.

**Extrinsic.** Two sensors see each other by E⁻¹ z E instead of z, with E where a sensor sits on its
robot. E and the alignment W of the maps are found together, by least squares on

    Log( (E z E⁻¹)⁻¹ X⁻¹ W Y )                                  (hand-eye calibration, AX = ZB)

with Cauchy's loss, from a few turns of the sensor that are usual: cameras look along z. That holds
as far as the maps do not drift; from there on E alone is found by the loops of pairs, each weighed
by its own covariance (`_loops`), in which W is no unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from pcm_jax import lie
from pcm_jax.graph import LoopClosures
from pcm_jax.integrity._loops import Loops
from pcm_jax.integrity._mistakes import Maps, with_measurement

HEADINGS, LIKELY = np.radians(np.arange(-180.0, 180.0, 0.5)), 60
"""Headings of one map in the other that are tried, and how many of them are followed."""
MOUNTED = 0.5
"""Metres within which sensors sit on robots, one sigma: what closures do not see stays small."""
STEPS, FOLLOWED, POLISHED = 40, 3, 2
"""Evaluations of a solve; starts that are followed, those that fit best; solves by loops."""
ALIKE = np.radians(20.0)
"""Headings that noise and drift may take for one."""
_STEP = 1e-6  # of differences: half the digits


def in_degrees(maps: Maps, closures: LoopClosures) -> Iterator[LoopClosures]:
    """The closures with angles written in degrees, in the plane; once for each likely heading."""
    values = np.array(lie.parameters(lie.as_numpy(closures.measurement)))
    read = np.arctan2(values[:, 1], values[:, 0])
    of_a, of_b = (
        np.asarray(lie.log(lie.take(lie.as_numpy(one.poses), np.asarray(poses))))[:, 2]
        for one, poses in zip(maps, (closures.pose_a, closures.pose_b), strict=True)
    )
    degrees = read[:, None] + 2.0 * np.pi * np.arange(-29, 58)
    written = (degrees > -180.0) & (degrees <= 360.0)
    possible = np.radians(degrees)
    off = (possible + (of_a - of_b)[:, None])[None] - HEADINGS[:, None, None]
    off = np.where(written, np.abs(np.angle(np.exp(1j * off))), np.inf)
    nearest, missing = off.argmin(axis=2), off.min(axis=2)
    likely = np.argsort(np.median(missing, axis=1), kind="stable")[:LIKELY]
    for reading in nearest[likely]:
        angle = possible[np.arange(len(read)), reading]
        values[:, 0], values[:, 1] = np.cos(angle), np.sin(angle)
        yield with_measurement(closures, closures.group(values.copy()))


def may_have_extrinsic(maps: Maps, closures: LoopClosures, enough: int) -> bool:
    """Says whether a sensor's pose could make enough closures agree.

    In the plane turns commute, so that no such pose changes the heading by which a closure turns
    map b: enough must share one, up to `ALIKE`. In space there is no such test.

    Args:
        maps: map a and map b.
        closures: all from a to b.
        enough: how many have to agree.
    """
    if lie.tangent_dim(closures.group) == 6:
        return True
    ends = zip(maps, (closures.pose_a, closures.pose_b), strict=True)
    x, y = (lie.take(lie.as_numpy(one.poses), np.asarray(poses)) for one, poses in ends)
    turned = lie.compose(lie.compose(x, lie.as_numpy(closures.measurement)), lie.inverse(y))
    heading = np.asarray(lie.log(turned))[:, 2]
    near = np.abs(np.angle(np.exp(1j * (heading[:, None] - heading)))) < ALIKE
    return int(near.sum(axis=1).max(initial=0)) >= enough


def with_extrinsic(
    covariances: Any,
    closures: LoopClosures,
    promising: Callable[[LoopClosures], bool] = lambda _: True,
) -> tuple[Any, LoopClosures]:
    """The sensor's pose on both robots that fits best, and the closures then.

    Args:
        covariances: a `MapCovariance` of map a and of map b.
        closures: all from a to b.
        promising: of the closures by a first fit, whether the loops are worth a closer one.
    """
    rows = np.arange(len(closures))
    apart = Loops(covariances, closures).misses(rows, np.roll(rows, len(rows) // 2))
    maps = tuple(covariance.pose_graph for covariance in covariances)
    fit = _HandEye(maps, closures, np.median(apart.sigma, axis=0))  # type: ignore[arg-type]
    begun = [(start, fit.middle(start)) for start in starts(closures.group)]
    at_first = [_cauchy(fit.off(*one)) for one in begun]
    ends = []
    for number in np.argsort(at_first, kind="stable")[:FOLLOWED]:
        start = begun[int(number)]
        found = _least(lambda tangents, start=start: fit.residuals(tangents, *start), 2 * fit.dim)
        moved, _ = fit.moved(found.x[None], *start)
        ends.append((found.cost, len(ends), lie.take(moved, (0, 0))))
    *_, extrinsic = min(ends)
    first = with_measurement(closures, fit.seen(extrinsic))
    for _ in range(POLISHED if promising(first) else 0):
        extrinsic = _polished(covariances, closures, fit, extrinsic)
    return extrinsic, with_measurement(closures, fit.seen(extrinsic))


def _polished(covariances: Any, closures: LoopClosures, fit: _HandEye, extrinsic: Any) -> Any:
    """The sensor's pose by the loops of all pairs of closures."""
    u, v = np.triu_indices(len(closures), 1)
    loops = Loops(covariances, with_measurement(closures, fit.seen(extrinsic)))
    white = loops.whitened(u, v)
    x, y = (
        lie.take(covariance.frame, np.asarray(poses))
        for covariance, poses in zip(covariances, (closures.pose_a, closures.pose_b), strict=True)
    )
    back = lie.inverse(y)

    def residuals(tangents: Any) -> Float[np.ndarray, "b r"]:
        moved = lie.compose(extrinsic, lie.exp(closures.group, tangents[:, None]))
        placed = lie.compose(lie.compose(x, fit.seen(moved)), back)
        at_u, at_v = (lie.take(placed, (slice(None), ends)) for ends in (u, v))
        loop = np.asarray(lie.log(lie.compose(at_v, lie.inverse(at_u))))
        off = np.einsum("pij,bpj->bpi", white, loop).reshape(len(tangents), -1)
        mounted = len(closures) * np.asarray(lie.translation(moved))[:, 0] / MOUNTED
        return np.concatenate([off, mounted], axis=1)

    step: Any = _least(residuals, fit.dim).x
    return lie.compose(extrinsic, lie.exp(closures.group, step))


def _least(residuals: Callable[[Any], Float[np.ndarray, "b r"]], size: int) -> Any:
    """The least squares of residuals that are found for many arguments `[b, size]` at once."""
    from scipy.optimize import least_squares

    def slopes(at: Any) -> Float[np.ndarray, "r size"]:
        values = residuals(np.vstack([at, at + _STEP * np.eye(size)]))
        return ((values[1:] - values[0]) / _STEP).T

    options: Any = {"jac": slopes, "loss": "cauchy", "max_nfev": STEPS}
    return least_squares(lambda at: residuals(at[None])[0], np.zeros(size), **options)


class _HandEye:
    """The residuals of closures measured between sensors, by where these sit on their robots."""

    def __init__(self, maps: Maps, closures: LoopClosures, scale: Float[np.ndarray, " 2"]):
        self.group, self.dim = closures.group, lie.tangent_dim(closures.group)
        self._space = 2 if self.dim == 3 else 3
        self._x, y = (
            lie.take(lie.as_numpy(one.poses), np.asarray(poses))
            for one, poses in zip(maps, (closures.pose_a, closures.pose_b), strict=True)
        )
        self._y, self._z = y, lie.as_numpy(closures.measurement)
        self._scale = np.repeat(scale, (self._space, self.dim - self._space))

    def seen(self, extrinsic: Any) -> Any:
        """The robots' relative poses: E z E⁻¹."""
        return lie.compose(lie.compose(extrinsic, self._z), lie.inverse(extrinsic))

    def off(self, extrinsic: Any, common: Any) -> Float[np.ndarray, "k d"]:
        """The residual of each closure, in sigmas, with an alignment or one for each."""
        expected = lie.compose(lie.inverse(self._x), lie.compose(common, self._y))
        return np.asarray(lie.log(lie.between(self.seen(extrinsic), expected))) / self._scale

    def middle(self, extrinsic: Any) -> Any:
        """The alignment by one of the closures that suits all best."""
        seen = self.seen(extrinsic)
        placed = lie.compose(lie.compose(self._x, seen), lie.inverse(self._y))
        off = self.off(extrinsic, lie.take(placed, (slice(None), None)))
        return lie.take(placed, int(np.log1p(off**2).sum(axis=(1, 2)).argmin()))

    def moved(self, tangents: Float[np.ndarray, "b 2*d"], extrinsic: Any, middle: Any) -> Any:
        """The extrinsic and the alignment of the maps, Lie `[b, 1]` each."""
        steps: Any = np.split(tangents[:, None], 2, axis=-1)
        return tuple(
            lie.compose(one, lie.exp(self.group, step))
            for one, step in zip((extrinsic, middle), steps, strict=True)
        )

    def residuals(
        self, tangents: Float[np.ndarray, "b 2*d"], extrinsic: Any, middle: Any
    ) -> Float[np.ndarray, "b r"]:
        """The residuals, in sigmas; and where the sensor sits, in those of `MOUNTED`."""
        extrinsic, common = self.moved(tangents, extrinsic, middle)
        off = self.off(extrinsic, common).reshape(len(tangents), -1)
        mounted = np.asarray(lie.translation(extrinsic))[:, 0] / MOUNTED
        return np.concatenate([off, mounted], axis=1)


def _cauchy(residual: Float[np.ndarray, "..."]) -> float:
    """The sum of Cauchy's losses."""
    return float(np.log1p(residual**2).sum())


def starts(group: type[Any]) -> Sequence[Any]:
    """Usual turns of a sensor: quarter turns, and a camera's axes (right, down, forward)."""
    d = lie.tangent_dim(group)
    tangents: Any = np.zeros((4, d))
    tangents[:, d - 1] = 0.0, np.pi / 2, -np.pi / 2, np.pi - 1e-3
    turns = [lie.exp(group, tangent) for tangent in tangents]
    if d == 3:
        return turns
    camera: Any = np.eye(4)
    camera[:3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    forward = lie.as_numpy(lie.from_matrix(camera))
    return [*turns, forward, lie.inverse(forward)]
