"""What there is to see of a run: whoever shows one, on a page, in a file or on a terminal, shows this."""
