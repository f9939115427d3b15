"""Tables that kgcp writes and reads: columns, Parquet, provenance."""
