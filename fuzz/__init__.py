"""Coverage-guided fuzzing of all readers: `make fuzz`. CONTRIBUTING.md says how."""
