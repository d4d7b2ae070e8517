// Programs of the 3D view, as pairs of a vertex and a fragment shader.

export const JOINTS = 24;
// Texels of a person in the texture of poses: three of each joint's bone, and its colour with the level of the surface plus 1.
export const POSE_TEXELS = 4 * JOINTS;
export const NEAR = 0.3; // near and far plane [m]
export const FAR = 700;

const COMMON = `#version 300 es
precision highp float;
uniform mat4 view;
`;
const LIT = `#version 300 es
precision highp float;
in vec3 normal; in vec3 tint; out vec4 color;
void main() {
  vec3 n = normalize(normal);
  float sun = max(0.0, dot(n, normalize(vec3(0.35, -0.45, 0.82))));
  color = vec4(tint * (0.5 + 0.16 * n.z + 0.42 * sun), 1.0);
}`;
export const SHADERS = {
  body: [`${COMMON}
layout(location=0) in vec3 at; layout(location=1) in vec3 turned; layout(location=2) in vec4 which; layout(location=3) in vec4 share;
layout(location=4) in float person;
uniform sampler2D poses; uniform float unit; uniform int joints; uniform float level;
out vec3 normal; out vec3 tint;
vec4 read(int column) { return texelFetch(poses, ivec2(column, int(person)), 0); }
void main() {
  normal = vec3(0.0, 0.0, 1.0); tint = vec3(0.0);
  if (read(${3 * JOINTS}).w != level) { gl_Position = vec4(0.0, 0.0, 2.0, 1.0); return; } // drawn with another surface, or not
  vec4 place = vec4(at * unit, 1.0);
  vec4 used = joints < 4 ? vec4(share.xy, 0.0, 0.0) : share;
  vec4 part = used / dot(used, vec4(1.0)); // rounded shares would shift far people
  vec3 there = vec3(0.0); vec3 facing = vec3(0.0);
  for (int k = 0; k < joints; k++) {
    int j = int(which[k]);
    vec4 a = read(3 * j), b = read(3 * j + 1), c = read(3 * j + 2);
    mat4x3 bone = mat4x3(a.xyz, b.xyz, c.xyz, vec3(a.w, b.w, c.w));
    there += part[k] * (bone * place);
    facing += part[k] * (mat3(bone) * turned);
    tint += part[k] * read(${3 * JOINTS} + j).rgb;
  }
  normal = facing;
  gl_Position = view * vec4(there, 1.0);
}`, LIT],
  capsule: [`${COMMON}
layout(location=0) in vec3 at; layout(location=1) in float end; layout(location=2) in vec4 one; layout(location=3) in vec3 two; layout(location=4) in vec3 paint;
out vec3 normal; out vec3 tint;
void main() {
  vec3 along = two - one.xyz; float length_ = length(along);
  vec3 w = length_ > 1e-4 ? along / length_ : vec3(0.0, 0.0, 1.0);
  vec3 u = normalize(cross(w, abs(w.z) < 0.9 ? vec3(0.0, 0.0, 1.0) : vec3(1.0, 0.0, 0.0))); vec3 v = cross(w, u);
  normal = at.x * u + at.y * v + at.z * w; tint = paint;
  gl_Position = view * vec4(mix(one.xyz, two, end) + one.w * normal, 1.0);
}`, LIT],
  line: [`${COMMON}
layout(location=0) in vec2 corner; layout(location=1) in vec4 one; layout(location=2) in vec3 two; layout(location=3) in vec4 paint;
uniform vec2 size; uniform float least; out vec4 tint;
void main() {
  vec4 a = view * vec4(one.xyz, 1.0); vec4 b = view * vec4(two, 1.0);
  if (a.w < ${NEAR} && b.w < ${NEAR}) { gl_Position = vec4(0.0, 0.0, 2.0, 1.0); return; }
  if (a.w < ${NEAR}) a = mix(a, b, (${NEAR} - a.w) / (b.w - a.w));
  if (b.w < ${NEAR}) b = mix(b, a, (${NEAR} - b.w) / (a.w - b.w));
  vec2 p = a.xy / a.w * size, q = b.xy / b.w * size;
  vec2 along = q - p; along = length(along) > 1e-6 ? normalize(along) : vec2(1.0, 0.0);
  vec4 here = corner.x < 0.5 ? a : b;
  float wide = one.w > 0.0 ? one.w * length(vec3(view[0][1], view[1][1], view[2][1])) * size.y / here.w : 0.0;
  vec2 off = vec2(-along.y, along.x) * corner.y * max(least, wide) * 0.5;
  gl_Position = vec4(here.xy + off * 2.0 / size * here.w * 0.5, here.zw);
  tint = paint;
}`, `#version 300 es
precision highp float;
in vec4 tint; out vec4 color;
void main() { color = tint; }`],
  ground: [`${COMMON}
layout(location=0) in vec2 corner; layout(location=1) in vec4 box; layout(location=2) in vec3 paint; uniform float level; flat out vec3 tint;
void main() { tint = paint; gl_Position = view * vec4(mix(box.xy, box.zw, 0.5 + 0.5 * corner), level, 1.0); }`, `#version 300 es
precision mediump float;
flat in vec3 tint; out vec4 color;
void main() { color = vec4(tint, 1.0); }`],
  spot: [`${COMMON}
layout(location=0) in vec2 corner; layout(location=1) in vec4 at; layout(location=2) in vec4 paint; out vec2 where_; out vec4 tint;
void main() { where_ = corner; tint = paint; gl_Position = view * vec4(at.xy + corner * at.w, at.z, 1.0); }`, `#version 300 es
precision highp float;
in vec2 where_; in vec4 tint; out vec4 color;
void main() { // shadows (black) are soft, discs have an edge
  float r = length(where_);
  float soft = 1.0 - smoothstep(0.15, 1.0, r);
  float disc = r > 1.0 ? 0.0 : (r > 0.86 ? 1.0 : 0.62);
  color = vec4(tint.rgb, tint.a * (dot(tint.rgb, tint.rgb) > 0.0 ? disc : soft));
}`],
  label: [`${COMMON}
layout(location=0) in vec2 corner; layout(location=1) in vec3 at; layout(location=2) in vec4 box; layout(location=3) in vec3 paint;
uniform vec2 size; uniform vec2 sheet; out vec2 spot; out vec3 tint;
void main() {
  vec4 there = view * vec4(at, 1.0);
  if (there.w < ${NEAR}) { gl_Position = vec4(0.0, 0.0, 2.0, 1.0); return; }
  vec2 off = vec2(corner.x * box.z * 0.5, (corner.y * 0.5 + 0.5) * box.w);
  vec2 middle = (floor((there.xy / there.w * 0.5 + 0.5) * size) + off) / size; // whole pixels keep letters sharp
  gl_Position = vec4((middle * 2.0 - 1.0) * there.w, there.zw);
  spot = (box.xy + vec2(0.5 + 0.5 * corner.x, 0.5 - 0.5 * corner.y) * box.zw) / sheet;
  tint = paint;
}`, `#version 300 es
precision highp float;
in vec2 spot; in vec3 tint; uniform sampler2D letters; out vec4 color;
void main() { vec4 seen = texture(letters, spot); color = vec4(tint * seen.rgb, seen.a); }`],
};
