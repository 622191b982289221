"""semdb.perception.detectors"""
