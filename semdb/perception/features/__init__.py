"""semdb.perception.features"""
