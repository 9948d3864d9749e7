"""Warning policy: TTC, headway, required deceleration, hysteresis."""
