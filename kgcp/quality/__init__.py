"""How good the results are: bias, consistency of vehicle and camera, robust estimation."""
