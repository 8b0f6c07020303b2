"""Maps from the echoes of an ultrasonic ring. Names load on first use, so that the command line starts at once."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
