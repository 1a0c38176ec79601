"""Reading measurement, ground-truth and face files; writing results."""
