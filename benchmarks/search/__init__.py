"""The search for rings: on frames that are hard to search, and on photographs without a target."""
