"""The agent process: the main loop, its Zenoh link, discovery of the world, journal and recovery."""
