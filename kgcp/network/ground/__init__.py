"""Static targets placed from oriented frames, and frames oriented by static targets."""
