#version 330 core
// Writes the number of the face, counted from 1, as a colour: red is the lowest byte.
uniform vec3 color;
out vec4 frag_color;

void main()
{
    int id = gl_PrimitiveID + 1;
    vec3 bytes = vec3(float(id & 255), float((id >> 8) & 255), float((id >> 16) & 255));
    // pyrender sets "color" (white here), so it must stay in use.
    frag_color = vec4(color * bytes / 255.0, 1.0);
}
