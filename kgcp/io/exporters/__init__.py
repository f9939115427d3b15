"""Writers of KGCPs, one module per receiving package.

A module offers `files(points: MapPoints) -> Mapping[str, str | bytes]`, paths below the results'
folder and what they hold, and has one entry in `formats.FORMATS` and in `write`. Where a package
needs several files they have a folder of their own, with a HOWTO.txt.
"""
