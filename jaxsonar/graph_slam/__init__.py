"""graph_slam."""
