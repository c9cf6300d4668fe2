"""Static reconstruction (thesis 4.1): posed depth pictures to a point cloud to a triangle mesh."""
