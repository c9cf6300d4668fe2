"""Names of files in an output folder that a person opens."""

PAGE_NAME = "index.html"
PLACE_NAME = "place.html"
VIDEO_NAME = "video.mp4"
SCENE_NAME, ENVIRONMENT_NAME = "scene.glb", "scene.hdr"
