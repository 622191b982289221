"""Maps as other programs read them, and as semdb itself reads them elsewhere: one file a format."""
