"""The measurements of `tandem bench`, each beside a baseline in the same run."""
