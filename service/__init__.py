"""HTTP service and command line on top of the worker floor."""
