"""Maximum-likelihood detection: the reflectors that explain the echoes of a scan best (``detector``)."""
