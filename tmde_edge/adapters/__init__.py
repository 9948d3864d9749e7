"""Hardware and runtime libraries behind small interfaces."""
