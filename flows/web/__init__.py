"""Review pages, served to browsers.

Input: a project, whose journals record all decisions. Output: a server; `flows.web.app` creates
it, and its other modules have one concern each. The pages themselves are built in
`infra/review_pages`.
"""
