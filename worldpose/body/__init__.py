"""Body model: joints, keypoints and surface [m] from shape, joint angles and position.

Input: `BodyParameters`, and the open body or an installed one. Output: world points.
`worldpose.body.jacobian` has derivatives for least squares, `worldpose.body.differentiable` has
gradients; only the latter needs torch.
"""
