"""Detection of lines and points in scans: local environment models (paper, section 4).

Entry points: ``extract.extract_lines``, ``extract.local_model``, ``extract.local_models``. The algorithm of the paper
is ``hough_detector.hough_detections``; the default method is ``ml_detector.ml_detections``.

Design decisions:

- Rows of the accumulator are theta, columns are rho, and both seams are kept: theta is periodic, and the column before
  rho = 0 is the first column half a turn away, because (-rho, theta) is the line (rho, theta + pi). Low pass, votes,
  components and centroids respect both.
- Votes are integers. Their sum does not depend on the order, so results do not depend on batch, order or device.
- The occupancy threshold is a fraction of a fully observed wall (paths per direction times points per cell). Therefore
  neither the point pitch nor the ring changes its meaning.
- A scan gives the same bits alone and in any batch: padding depends on the scan alone where floats are summed.
- Arcs are cut into pieces of 16 points, because direct paths have four times the points of third neighbors: rectangles
  of whole arcs would be half empty.
- Centroids are summed on the host over runs of points, along the memory. A GPU would wait for the components anyway.
- OpenCV labels only the rows with occupied cells, of all scans of a batch in one image.
- Lines and points are reported with a posterior probability of 0.7 or more; all others are reported as undecided with
  their probabilities. Direct echoes alone do not distinguish a corner from an edge.
- In windows of scans a post reflects into every pose, and its arcs intersect like those of a wall. A plane must explain
  4/3 of the echoes that a point explains.
"""
