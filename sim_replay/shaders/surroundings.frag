// A window in one pass: its surroundings at pixel resolution with the supersampled aircraft averaged over them.
uniform sampler2D aircraft_colour;
uniform sampler2D aircraft_coordinate;
uniform ivec4 tile;            // x, y of the tile; samples across a pixel; 0
uniform ivec4 crop;            // pixels of the tile that the aircraft may touch: x0, y0, x1, y1
uniform ivec2 crop_at;         // its corner in the supersampled buffer
layout(location = 0) out vec4 colour;
layout(location = 1) out vec4 coordinate;

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy) - tile.xy;
    vec3 ray = ray_ned(vec2(pixel));
#ifdef SKY
    vec3 sky_there = sky(ray);
#else
    vec3 sky_there = vec3(0.0);
#endif
    vec3 background = surroundings(ray, sky_there) + veil(ray);
    vec3 sum = vec3(0.0);
    vec4 body = vec4(0.0);
    float covered = 0.0, hit = 0.0, number = 0.0, share = 0.0;
    coordinate = vec4(0.0);
    if (all(greaterThanEqual(pixel, crop.xy)) && all(lessThan(pixel, crop.zw))) {
        ivec2 corner = crop_at + (pixel - crop.xy) * tile.z;
        for (int j = 0; j < tile.z; ++j) for (int i = 0; i < tile.z; ++i) {
            vec4 c = texelFetch(aircraft_colour, corner + ivec2(i, j), 0);
            vec4 b = texelFetch(aircraft_coordinate, corner + ivec2(i, j), 0);
            sum += c.a * c.rgb * c.rgb;
            covered += c.a;
            if (b.w > 0.5) {
                hit += 1.0;
                // Majority vote (Boyer and Moore): a pixel that two targets share belongs to one of them.
                if (share == 0.0) number = b.w;
                share += b.w == number ? 1.0 : -1.0;
            }
        }
        for (int j = 0; j < tile.z && hit > 0.0; ++j) for (int i = 0; i < tile.z; ++i) {
            vec4 b = texelFetch(aircraft_coordinate, corner + ivec2(i, j), 0);
            if (b.w == number) body += vec4(b.xyz, 1.0);
        }
        float samples = float(tile.z * tile.z);
        sum /= samples; covered /= samples; hit /= samples;
        if (body.w > 0.0) coordinate = vec4(body.xyz / body.w, number);
    }
    vec3 seen = sum + (1.0 - covered) * background;
    float shred = near_cloud(ray);
    seen = mix(seen, near_cloud_colour(), shred);
    if (shred > 0.5) { hit = 0.0; coordinate.xyz = vec3(0.0); }
    // Blue first, as OpenCV stores it; alpha is the share of the pixel that the aircraft covers.
    colour = vec4(sqrt(clamp(seen, 0.0, 1.0)).bgr, hit);
}
