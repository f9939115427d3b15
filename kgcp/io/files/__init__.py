"""What all readers and writers stand on: safe reading, atomic writing, locks, times."""
