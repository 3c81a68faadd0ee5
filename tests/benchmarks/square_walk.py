"""A square walk with candidates, in the formats of the real files: a stand-in for them."""

from __future__ import annotations

import lzma

import numpy as np

SIDE, ROUNDS = 12, 4
ROUND = 4 * SIDE
POSES = ROUNDS * ROUND
SIGMAS = np.array([0.03, 0.02, 0.004])
STEPS = [(k, k + 1) for k in range(POSES - 1)]
RIGHT = [(k, k - ROUND) for k in range(ROUND, POSES, 5)]
FALSE = [(k, k - 17) for k in range(60, POSES, 9)]
KITTI, RRR = "kitti_99_alpha_0.50", "Walk_0.300"


def square_walk():
    """True x, y, heading of a square walked several times, 1 m a step, `[n, 3]`."""
    turning = np.arange(POSES) % SIDE == SIDE - 1
    heading = np.concatenate([[0.0], np.cumsum(np.where(turning, np.pi / 2, 0.0))[:-1]])
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    places = np.concatenate([np.zeros((1, 2)), np.cumsum(ahead[:-1], axis=0)])
    return np.column_stack([places, heading])


def edge_lines(pairs, sigmas, generator):
    """g2o lines of measured edges; the false ones say that two poses are the same."""
    information = " ".join(repr(float(x)) for x in np.diag(SIGMAS**-2)[np.triu_indices(3)])
    true, lines = square_walk(), []
    for i, j in pairs:
        away, turn = true[j] - true[i], true[i, 2]
        c, s = np.cos(turn), np.sin(turn)
        z = np.array([c * away[0] + s * away[1], c * away[1] - s * away[0], away[2]])
        z[2] = np.arctan2(np.sin(z[2]), np.cos(z[2]))
        z = np.zeros(3) if (i, j) in FALSE else z + sigmas * generator.normal(size=3)
        lines.append(f"EDGE_SE2 {i} {j} {z[0]!r} {z[1]!r} {z[2]!r} {information}\n")
    return "".join(lines).replace("np.float64(", "").replace(")", "")


def write_files(folder):
    """One file of either collection, below a folder: the same walk and candidates."""
    generator = np.random.default_rng(0)
    measured = edge_lines(STEPS + RIGHT + FALSE, SIGMAS, generator)
    kitti, rrr = folder / "kitti_robust" / "99", folder / "rrr"
    kitti.mkdir(parents=True)
    rrr.mkdir()
    (kitti / f"{KITTI}.g2o").write_text("# candidates\n\n" + measured)
    (kitti / "kitti_99_GT.g2o").write_text(edge_lines(STEPS, 0.0 * SIGMAS, generator))
    listed = "".join(f"{i} {j}\n" for i, j in RIGHT)
    (kitti / f"{KITTI}_GT_LC.txt.xz").write_bytes(lzma.compress(listed.encode()))
    (rrr / f"{RRR}.g2o").write_text(measured)
    (rrr / "Walk_timestamps.txt").write_text("".join(f"{100 + k}.5\n" for k in range(POSES)))
    times = 99.5 + np.arange(POSES + 1)  # the first before all poses, then one for each
    true = square_walk()[np.maximum(np.arange(POSES + 1) - 1, 0)]
    true[:, 2] = np.arctan2(np.sin(true[:, 2]), np.cos(true[:, 2]))
    rows = np.column_stack([times, true])
    np.savetxt(rrr / "Walk-GT-extended.csv", rows, fmt="%.9f", delimiter=", ")
