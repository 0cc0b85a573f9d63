"""Range recordings: odometry, ranges and truth of one or more robots, from Tandem or from real radios."""
