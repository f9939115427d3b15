"""First flights: folders with the files of card and rover, and the commands that make points."""
