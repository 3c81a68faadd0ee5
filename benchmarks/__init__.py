"""Measurements of what the package promises and of what the paper reports.

`python -m benchmarks` runs the suite of promised figures. Every experiment of the paper, and seven
beyond it, is a command of its own.

    suite                   the promised figures, each beside what it is compared with
    one_dimensional_world   Figs 2 and 3: every method against enumeration
    city                    Figs 4 and 5, Table I: City10000 with clutter
    city_laws               Table I under other laws of the false closures
    sessions                Figs 6 and 7, Table II: two sessions of one robot in space
    place_recognition       real place recognition, and closures inside one robot's map
    cosmo                   labelled multi-robot sets in JRL: PCM, GNC, everything
    integrity               when robots that never met are merged, by rule
    covariances             the worth of the right covariance of the maps
    growth                  time and memory to 50,000 closures
    learning                a network trained through the check and the merge
    experiments             what these share: methods, worlds, options of the command line
    results                 what they wrote: the numbers that documents cite
    pictures                the README's picture
"""
