"""What there is to see in an output folder: its page `index.html`, the camera's pictures and the video."""
