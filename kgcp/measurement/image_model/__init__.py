"""Image of a plate: blur, exposure, tone curve, sharpening, noise."""
