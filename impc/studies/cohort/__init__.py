"""Study of many subjects with bootstrap replicates, on one machine or a cluster."""
