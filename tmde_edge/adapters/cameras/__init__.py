"""Frame sources: V4L2, video files, image folders."""
