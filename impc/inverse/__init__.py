"""Inverse problem and estimation methods: from recordings to gains and weights."""
