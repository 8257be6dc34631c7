"""Which physical effect a model lacks, told from measurements."""
