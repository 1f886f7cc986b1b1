"""Study bowtie."""
