"""The second simulator: match folders that share no model with the first.

Inputs: a `ForeignScenario`, a seed, and recordings if there are any.
Outputs: a match folder with its ground truth. Nothing here is shared with the first simulator: no
motion, no noise, no camera placement; estimators are measured on it and never tuned on it.
"""
