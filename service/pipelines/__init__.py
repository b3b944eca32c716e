"""Jobs from files to files: the only place where stage and kernels are imported together."""
