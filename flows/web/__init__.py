"""Pages for people in the loop, served to browsers.

Input: a project, whose journals keep all that is said. Output: a server; `flows.web.app` makes
it, and its other modules are one concern each. The pages themselves are built in
`infra/review_pages`.
"""
