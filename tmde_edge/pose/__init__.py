"""Camera attitude: lane vanishing point, horizon, compensation."""
