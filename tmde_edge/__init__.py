"""tmde-edge: distance and time to collision from the number plate of the vehicle ahead, with one camera."""

__version__ = "0.1.0"
