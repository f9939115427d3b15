"""What a plate looks like: blur, exposure, tone curve, sharpening, noise."""
