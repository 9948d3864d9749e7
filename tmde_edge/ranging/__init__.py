"""From a sighting's pixels and a plate standard's millimetres to metres with a sigma."""
