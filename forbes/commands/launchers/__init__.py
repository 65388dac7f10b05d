"""Where the jobs of `forbes compare` and `forbes reproduce` run: processes of this machine, Ray tasks, SLURM jobs."""
