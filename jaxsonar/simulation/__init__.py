"""Simulation: exact echoes of a ring in a floor plan, measurement errors, odometry, and device messages.

Entry points: ``simulator.simulate``, ``random_rooms.random_room``, ``random_rooms.random_pose``,
``wheel_odometry.simulate_odometry``, ``device_messages.log_messages``, ``office.load_office``.

Design decisions:

- The simulator is written in NumPy with double precision and shares no measurement model with the kernels, so that each
  is a check of the other.
- Geometry is exact: image sources, diffraction and scattering with occlusion.
- Beams are soft by default: an echo is detected if its amplitude reaches the threshold. The Gaussian beam loses
  ``beam_edge_db`` at the border of the nominal cone. Hard beams also require both legs within the cones.
- Edges are weak (0.02 of a wall at 1 m): Keller's diffraction coefficient at 40 kHz.
"""
