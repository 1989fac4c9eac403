"""Many subjects, many replicates, on one machine or a cluster."""
