"""Registration: poses of scans from the scans alone, or with drifting odometry, in a place without a map.

Entry points: ``sequential_registration.register_scans`` and ``register_remaining``,
``agglomerative_registration.register_by_ranges``.
Localization and loop closure use the parts: ``features`` (the container of walls and points), ``pose_hypotheses``,
``pose_likelihood``.

Two methods share these parts, because neither can replace the other:

- Sequential registration uses features and odometry. It takes seconds for long logs, and tolerates a ring that is not
  calibrated. Calibration, localization, the smoother and logs of more than 64 scans use it.
- Agglomerative registration uses ranges and no odometry. It takes seconds per scan and needs a calibrated ring.

Office, 17 scans without odometry, on a busy machine:

==================================== ======================== ==========================
condition                            sequential               agglomerative
==================================== ======================== ==========================
calibrated, 5 mm noise, seed 0       3 scans, 2 mm, 1.3 s     17 scans, 4 mm, 226 s
calibrated, 5 mm noise, seed 1       3 scans, 2 mm, 1.3 s     16 scans, 43 mm, 192 s
offsets of 5 mm, 1 % speed, 1 mm     6 scans, 2 mm, 2 s       8 scans, 14 mm, 324 s
==================================== ======================== ==========================

Scans of the largest cluster, root mean square of their positions after alignment. In the last row the second cluster of
the agglomerative method has errors of 36 mm (76 mm at most), that of the sequential method 6 mm.

Decisions:

- Without odometry the surest pair is merged first. At 5 mm noise single scans leave the kinds of reflectors undecided,
  and may fit several poses. Therefore every scan begins as a cluster, and two clusters are merged only if one alignment
  beats all others. An ambiguous scan waits until the map around it has grown.
- An alignment that leaves a direction undetermined competes with the others at its best position along that direction.
- A common corner of two common walls is no additional evidence.
- ``cluster_adjustment`` does not use the sparse solver of ``estimation``. Clusters are small, the evidence needs the
  full covariance, and kinds of reflectors change between steps.
- ``local_reflectors`` and ``motion_fit`` take poses as given within the errors of odometry, and find the scale of the
  ranges and the time offset between echoes and poses; the health check compares causes with them. NumPy only.
"""
