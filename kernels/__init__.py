"""Numerical kernels in JAX: pure functions on arrays, written for one echo, one reflector or one scan, and vmapped.

Modules, in the order of the data:

- ``sensor_array``: sensors -> echo paths (transmitter-receiver pairs). ``isorange_arcs``: the arc of one echo.
- ``hough_voting``, ``hough_accumulator``: arcs -> tangent lines -> votes -> low pass -> threshold (paper, section 4).
- ``measurement_model``: the only range model of plane, corner, edge and circle. ``detection_cones``: which echoes are
  received. ``landmarks``: reflectors of the world.
- ``robust_fit``: one reflector fitted to echoes. ``ml_detection``: all reflectors of a scan.
- ``data_association``, ``iterated_ekf``, ``bundle_adjustment``: echoes and landmarks, poses and ring parameters.
- ``focus_measure``, ``beam_pattern``: ring parameters without landmarks, and the detection cones of the sensors.
- ``occupancy_evidence``: cells that echoes come from, cells that were seen through, and grids after Bayes.
- ``planar_geometry``: vectors, poses and lines. ``shape_buckets``: sizes of padded arrays.

Kernels that have a slow NumPy oracle in ``tests/support/oracles.py`` name it in their docstrings.

Design decisions:

- The parameter space of lines has two seams: theta wraps, and (-rho, theta) is (rho, theta + pi). Low pass, soft
  votes, local maxima and connected components extend across both.
- Votes are integers, so that the result does not depend on batch, order or device. ``soft_accumulate`` is the
  differentiable counterpart.
- The vote threshold is a fraction of the votes of a fully visible wall (paths per direction times points per cell), so
  that its meaning depends neither on the point pitch nor on the ring.
- Detection ranges of the Hough transform are far-field, the intersection of two cones, as in the paper. The
  measurement model tests both legs of an echo exactly.
- Sensor poses and pose-dependent arcs are data, not shapes: a calibrated ring or a moving robot compiles nothing
  again.
- Arcs are packed in pieces of 16 points: the arc of a direct path has four times as many points as that of a third
  neighbor.
- Kernels of the ML detector are written in scalar components (``planar_geometry.dot``) and vmapped with the echoes as
  the last axis: XLA then generates few, vectorized loops.
- Scans are mapped on a CPU, which keeps the accumulator in its cache and gives the same bits in every batch, and
  vmapped on a GPU.
- The ML detector selects reflectors greedily and repeats this in passes over the whole scan. The passes matter more
  than soft assignment: with 3 mm noise, 2 nats distinguish a corner from a wall by its ranges alone, but 10 nats once
  both of its walls are known. Its evidence is tempered and weighted, because residuals, missed detections and prior
  have common errors.
"""

from .beam_pattern import BeamPattern as BeamPattern
from .beam_pattern import beam_negative_log_likelihood as beam_negative_log_likelihood
from .beam_pattern import off_axis_angles as off_axis_angles
from .bundle_adjustment import EchoFactors as EchoFactors
from .bundle_adjustment import Jacobians as Jacobians
from .bundle_adjustment import LeastSquaresProblem as LeastSquaresProblem
from .bundle_adjustment import Unknowns as Unknowns
from .bundle_adjustment import apply_parameters as apply_parameters
from .bundle_adjustment import cost as cost
from .bundle_adjustment import linearize as linearize
from .bundle_adjustment import odometry_residuals as odometry_residuals
from .bundle_adjustment import residuals as residuals
from .data_association import CandidateReflections as CandidateReflections
from .data_association import EchoAssociation as EchoAssociation
from .data_association import associate as associate
from .hough_accumulator import HoughSettings as HoughSettings
from .hough_accumulator import accumulate as accumulate
from .hough_accumulator import cell_of as cell_of
from .hough_accumulator import full_wall_votes as full_wall_votes
from .hough_accumulator import lowpass as lowpass
from .hough_accumulator import soft_accumulate as soft_accumulate
from .hough_accumulator import theta_row as theta_row
from .hough_voting import PIECE_POINTS as PIECE_POINTS
from .hough_voting import PackedEchoes as PackedEchoes
from .hough_voting import RingArcs as RingArcs
from .hough_voting import Votes as Votes
from .hough_voting import accumulators as accumulators
from .hough_voting import points_of_widest_arc as points_of_widest_arc
from .hough_voting import ring_arcs as ring_arcs
from .hough_voting import tangent_lines as tangent_lines
from .hough_voting import vote as vote
from .hough_voting import vote_lines as vote_lines
from .isorange_arcs import Arc as Arc
from .isorange_arcs import arc as arc
from .isorange_arcs import arc_point as arc_point
from .isorange_arcs import tangent_rho as tangent_rho
from .iterated_ekf import Belief as Belief
from .iterated_ekf import EkfUpdate as EkfUpdate
from .iterated_ekf import ExpectedRanges as ExpectedRanges
from .iterated_ekf import ekf_update as ekf_update
from .iterated_ekf import expected_ranges as expected_ranges
from .iterated_ekf import expected_ranges_with_variance as expected_ranges_with_variance
from .landmarks import Landmarks as Landmarks
from .landmarks import Reflection as Reflection
from .landmarks import landmark_echo as landmark_echo
from .landmarks import landmark_in_robot_frame as landmark_in_robot_frame
from .landmarks import predict_reflection as predict_reflection
from .measurement_model import CIRCLE as CIRCLE
from .measurement_model import CORNER as CORNER
from .measurement_model import EDGE as EDGE
from .measurement_model import PLANE as PLANE
from .measurement_model import SECOND_ORDER as SECOND_ORDER
from .measurement_model import CurvedEcho as CurvedEcho
from .measurement_model import circle_echo as circle_echo
from .measurement_model import circle_range as circle_range
from .measurement_model import corner_range as corner_range
from .measurement_model import corrected_range as corrected_range
from .measurement_model import curved_echo as curved_echo
from .measurement_model import edge_range as edge_range
from .measurement_model import expected_range as expected_range
from .measurement_model import plane_range as plane_range
from .measurement_model import reported_range as reported_range
from .ml_detection.detector import REFLECTOR_KINDS as REFLECTOR_KINDS
from .ml_detection.detector import Detections as Detections
from .ml_detection.detector import detect_ml as detect_ml
from .ml_detection.settings import DetectionSettings as DetectionSettings
from .occupancy_evidence import CONE_MARGIN as CONE_MARGIN
from .occupancy_evidence import DIRECTIONS as DIRECTIONS
from .occupancy_evidence import ArcCells as ArcCells
from .occupancy_evidence import SeenThrough as SeenThrough
from .occupancy_evidence import arcs_of_echoes as arcs_of_echoes
from .occupancy_evidence import expected_echoes as expected_echoes
from .occupancy_evidence import log_odds as log_odds
from .occupancy_evidence import seen_through as seen_through
from .planar_geometry import fold_line as fold_line
from .planar_geometry import normal as normal
from .planar_geometry import segment_endpoints as segment_endpoints
from .planar_geometry import tangent as tangent
from .planar_geometry import wrap_angle as wrap_angle
from .robust_fit import CandidateFits as CandidateFits
from .robust_fit import fit_candidates as fit_candidates
from .sensor_array import EchoPaths as EchoPaths
from .sensor_array import SensorArray as SensorArray
from .sensor_array import echo_paths as echo_paths
from .sensor_array import transform_path as transform_path
