"""Every camera's clock: by sound, flashes, motion, recorded times; checked by geometry."""
