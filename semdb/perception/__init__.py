"""semdb.perception"""
