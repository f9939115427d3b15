"""Files of other programs: calibrations, orientations, trajectories, frame times."""
