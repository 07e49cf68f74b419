"""Recordings that others made: readers and writers behind two protocols and one table.

The only package that imports rosbags and mcap.
"""
