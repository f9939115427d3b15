"""The closed-form method of Cucci (2016)."""
