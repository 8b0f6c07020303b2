"""floor_plans."""
