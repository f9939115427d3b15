"""One grey array in, measurements or named rejections out."""
