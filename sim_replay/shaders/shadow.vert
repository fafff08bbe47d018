#version 330 core
// The aircraft as the sun sees it; only depth is kept.
uniform mat4 clip_from_body;
in vec3 in_position;
void main() { gl_Position = clip_from_body * vec4(in_position, 1.0); }
