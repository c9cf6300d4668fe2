"""What a run leaves in its output folder: frames and rows, its page `index.html`, the camera's pictures, the video."""
