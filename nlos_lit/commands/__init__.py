"""What the commands do; the files of the same names at the top of the repository are their doors."""
