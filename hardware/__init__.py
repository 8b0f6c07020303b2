"""The hardware layer: bytes and recordings of devices on one side, plain frames of echoes on the other. No JAX."""

from .errors import SonarError as SonarError
