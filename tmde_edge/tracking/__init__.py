"""Kalman filters, ego motion, choice of the lead vehicle."""
