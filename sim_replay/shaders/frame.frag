// The surroundings of a whole frame without any aircraft; alpha is what cloud before the aircraft hides.
#ifdef BACKDROP
uniform sampler2D backdrop;
uniform vec3 backdrop_map;     // turn rad, width rad, height / width; 0: a panorama
#else
uniform sampler2D far_sky;
#endif
layout(location = 0) out vec4 colour;

#ifdef BACKDROP
vec3 pictured(vec3 d) {
    float azimuth = atan(d.y, d.x) + backdrop_map.x, elevation = asin(clamp(-d.z, -1.0, 1.0));
    vec2 at = vec2(azimuth, -elevation) / (backdrop_map.y * vec2(1.0, max(backdrop_map.z, 0.5))) + 0.5;
    // A photograph repeats mirrored. The level is given: where the azimuth wraps round, its derivative means nothing.
    if (backdrop_map.z > 0.0) at = 1.0 - abs(mod(at, 2.0) - 1.0);
    float texels = float(textureSize(backdrop, 0).x) / (backdrop_map.y * K.x);
    vec3 c = textureLod(backdrop, at, max(log2(texels), 0.0)).rgb;
    return c * c;
}
#endif

void main() {
    vec2 pixel = floor(gl_FragCoord.xy);
    vec3 ray = ray_ned(pixel);
#ifdef BACKDROP
    vec3 background = pictured(ray);
#else
    vec3 sky_there = vec3(0.0);
#ifdef SKY
    sky_there = texture(far_sky, (pixel + 0.5) * 0.5 / vec2(textureSize(far_sky, 0))).rgb;
    sky_there *= sky_there;
#endif
    vec3 background = surroundings(ray, sky_there);
#endif
    colour = vec4(sqrt(clamp(background + veil(ray), 0.0, 1.0)).bgr, near_cloud(ray));
}
