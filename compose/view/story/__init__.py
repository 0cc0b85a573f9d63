"""The story of a mission in captions, for readers who do not know the method."""
