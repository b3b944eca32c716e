"""Jobs for render farms: Open Job Description templates whose tasks are plain calls of this program."""
