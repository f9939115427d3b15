"""From sightings to points on the map: CRS, trajectory, target positions, GCPs."""
