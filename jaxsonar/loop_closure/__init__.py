"""loop_closure."""
