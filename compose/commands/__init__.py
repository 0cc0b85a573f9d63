"""The commands of `tandem`, a module each, so that none imports what another uses."""
