"""Questions about an answer: is a given pose optimal, is the answer the only one?"""
