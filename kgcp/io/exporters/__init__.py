"""Writers of KGCPs, one module per receiving package.

A module offers `files(points: MapPoints) -> Mapping[str, str | bytes]`: paths below the results'
folder with their contents. It has one entry in `formats.FORMATS` and one in `write`. Several files
for one package are written to a folder of their own, with a HOWTO.txt.
"""
