"""Model of the image of a plate: blur, exposure, tone curve, sharpening, noise."""
