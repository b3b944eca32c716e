"""Estimates of one camera that follow each other in time: whether they agree, and their recursive mean."""
