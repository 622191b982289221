"""semdb.evaluation"""
