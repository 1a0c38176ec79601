"""The queue contract: job records, object storage and the task that RQ runs."""
