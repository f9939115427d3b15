"""Calibration compared with published adjustments and with other people's photographs."""
