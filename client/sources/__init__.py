"""Sources of RGB-D frames. `frame_source.Source` is their interface."""
