"""Running one function on many frames: processes, Dask, journal, signals."""
