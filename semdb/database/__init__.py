"""semdb.database"""
