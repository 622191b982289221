"""semdb.localization"""
