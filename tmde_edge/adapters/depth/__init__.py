"""Relative depth networks."""
