"""The programs of Tandem: starting processes, reading and writing files, figures, pages, the command line."""
