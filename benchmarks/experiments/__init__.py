"""Modules that the experiments share.

command                 options that all have, tasks in processes, the record of a run
record                  rows and means of figures, CSV, progress, what results depend on
one_dimensional         settings of the one-dimensional world, and selectors by batches
solver_timing           seconds of the methods on one such world, and where they give up
city_report             Table I, Fig. 4 and Fig. 5 of a run over City10000
table_one               Table I in the report, beside the paper's
nclt                    NCLT's odometry and ground truth, as keyframes
registrations           simulated registrations between sessions, poor and aliased ones too
drifting                worlds whose maps drift and close loops more or less
real_candidates         the noise of real front ends' candidates
real_candidate_report   figures, tables and pictures of those
symforce_peer           a pose graph by SymForce's optimiser
ceres_peer              a planar one by Ceres
mrob_peer               one by mrob, in a process of its own
learning_worlds         cities with closures of unequal noise, slipped ones and scores
learning_model          the network, its losses and its training
"""
