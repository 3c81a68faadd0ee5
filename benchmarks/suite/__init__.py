"""The figures that this package promises, measured, each beside what it is compared with.

    python -m benchmarks [--quick] [--only NAME ...] [--data DIR] --out DIR

    maps            the pose graphs measured on: public files, or simulated ones
    random_worlds   random maps and closures of either group, with the noise they state
    gtsam_peer      the same graphs, solves and marginals by GTSAM
    clique_graphs   hard graphs, and those like a consistency graph
    clique_peers    maximum cliques by other packages
    one_solve       one solve in a process of its own, ours or GTSAM's, for its memory
    measure         time (compilation apart), memory, the machine
    harness         cases and metrics; each case in a process of its own, kept once it is done
    report          summary.json, the table, the baseline, the table in benchmarks/README.md
    headlines       the promised figures in benchmarks/README.md, and six in the top one

One module per subject, each with a list `CASES`: optimization, marginals, memory, distances,
streaming, world_sweeps, sweeps, cliques, calibration, files, end_to_end.
"""
