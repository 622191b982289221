"""The Celery application of the ingestion workers."""
