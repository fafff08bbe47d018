#version 330 core
// One aircraft alone, its samples averaged: premultiplied colour with gamma 2, and how much of each pixel it takes.
uniform sampler2D aircraft_colour;
uniform sampler2D aircraft_coordinate;
uniform ivec2 samples;         // across a pixel; 0
layout(location = 0) out vec4 colour;
layout(location = 1) out vec4 coordinate;

void main() {
    ivec2 corner = ivec2(gl_FragCoord.xy) * samples.x;
    vec3 sum = vec3(0.0);
    float covered = 0.0, hit = 0.0;
    for (int j = 0; j < samples.x; ++j) for (int i = 0; i < samples.x; ++i) {
        vec4 c = texelFetch(aircraft_colour, corner + ivec2(i, j), 0);
        sum += c.a * c.rgb * c.rgb;
        covered += c.a;
        hit += texelFetch(aircraft_coordinate, corner + ivec2(i, j), 0).w > 0.5 ? 1.0 : 0.0;
    }
    float count = float(samples.x * samples.x);
    colour = vec4(sqrt(sum / count).bgr, hit / count);
    coordinate = vec4(covered / count, 0.0, 0.0, 0.0);
}
