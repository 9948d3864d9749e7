"""Focal length and lens from captures of known things: plates, chessboards, ChArUco boards; priors of known cameras. Pure."""
