"""From a frame to a Sighting: pixels in, pixels out. Vision never knows metres."""
