"""semdb.perception.encoders"""
