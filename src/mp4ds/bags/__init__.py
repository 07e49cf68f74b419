"""Recordings: readers and writers behind two protocols and one table of formats.

The only package that imports rosbags and mcap.
"""
