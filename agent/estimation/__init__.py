"""What noisy ranges tell: the path and its drift, fits of it, hypotheses with odds, and doubt of a peer."""
