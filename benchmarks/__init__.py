"""Measurements of what the package promises and of what the paper reports.

`python -m benchmarks` runs the suite of promised figures. Every experiment of the paper, and
thirteen beyond it, is a command of its own.

    suite                   the promised figures, each beside what it is compared with
    one_dimensional_world   Figs 2 and 3: every method against enumeration
    city                    Figs 4 and 5, Table I: City10000 with clutter
    city_laws               Table I under other laws of the false closures
    sessions                Figs 6 and 7, Table II: two sessions of one robot in space
    place_recognition       real place recognition, and closures inside one robot's map
    cosmo                   labelled multi-robot sets in JRL: PCM, GNC, everything
    integrity               when robots that never met are merged, by rule
    cuts                    real drives cut at many poses: which cuts each rule merges
    answers                 NEES of the answer: anchors and merged poses, as maps drift
    refine                  graduated non-convexity and recall from PCM's answer
    calibration_coverage    how often the intervals of `calibrate` hold
    real_noise              what `calibrate` says of real files, and what the truth says of them
    silence                 worlds without a mistake, and in how many of them triage names one
    covariances             the worth of the right covariance of the maps
    growth                  time and memory to 50,000 closures
    learning                a network trained through the check and the merge
    experiments             what these share: methods, worlds, options of the command line
    results                 what they wrote: the numbers that documents cite
    pictures                the README's pictures
"""
