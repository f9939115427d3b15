"""Files and the records that they hold: reading, writing, no decisions."""
