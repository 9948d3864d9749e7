"""The local web page: live picture, distance, alert, charts of the last minute, and an aid for aiming and focusing."""
