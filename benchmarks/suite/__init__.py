"""The figures that this package promises, measured, each beside what it is compared with.

    python -m benchmarks [--quick] [--only NAME ...] [--data DIR] --out DIR

harness      cases and metrics; runs each case in a process of its own, resumes after a kill
measure      time (compilation apart), memory, the machine
report       summary.json, the table, the committed baseline, the table in benchmarks/README.md
maps         the pose graphs measured on: public files, or simulated ones where those are absent
gtsam_peer   the same graphs, solves and marginals by GTSAM
clique_peers, clique_graphs   maximum cliques by other packages, and the graphs for it

one_solve    one solve in a process of its own, ours or GTSAM's, for its memory

One module per subject, each with a list `CASES`: optimization, marginals, memory, distances,
streaming, world_sweeps, sweeps, cliques, calibration, files, end_to_end.
"""
