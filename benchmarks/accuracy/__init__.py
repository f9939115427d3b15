"""Errors of the measurement on simulated flights, against truth and bound."""
