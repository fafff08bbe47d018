// The sky of a whole frame at half its resolution: clouds have no finer detail, and it costs a quarter.
layout(location = 0) out vec4 colour;
void main() { colour = vec4(sqrt(sky(ray_ned(2.0 * gl_FragCoord.xy - 0.5))), 1.0); }
