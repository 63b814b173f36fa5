"""Bird's eye view from cameras: the blocks that VAD-tiny and UniAD-tiny share."""
