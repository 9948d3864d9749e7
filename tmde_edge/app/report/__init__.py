"""One self-contained HTML page about a recording: plots as inline SVG, thumbnails at events, a summary in plain words."""
