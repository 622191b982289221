"""semdb.recordings"""
