"""semdb.cli"""
