"""What is measured about kgcp, as opposed to tested: accuracy, exposure, time."""
