// Writes grids of points with OpenVDB, and what it reads of them as text: a line for each point.
//
//     write_points FOLDER
//
//     null.vdb      positions of 32 bits, Blosc; all types of attributes, strings and groups
//     fixed8.vdb    8 bits, no compression; a translation
//     fixed16.vdb   16 bits, ZIP
//     truncated.vdb 16-bit floats, Blosc; another size of voxels along each axis
//     two.vdb       two grids of points with a grid of floats between them

#include <fstream>
#include <iomanip>
#include <openvdb/openvdb.h>
#include <openvdb/points/PointConversion.h>
#include <openvdb/points/PointGroup.h>

using namespace openvdb;
using namespace openvdb::points;

using Codec8 = FixedPointCodec<true, PositionRange>;
using Codec16 = FixedPointCodec<false, PositionRange>;

// A number from 0 to 1, the same on every machine.
static float random_number()
{
    static unsigned state = 1;
    state = state * 1664525u + 1013904223u;
    return float(state >> 8) / float(1 << 24);
}

// Adds an attribute with values that the index of a point gives.
template <typename T, typename Codec, typename Value>
static void add(PointDataTree& tree, const Name& name, Value value)
{
    appendAttribute<T, Codec>(tree, name);
    int index = 0;
    for (auto leaf = tree.beginLeaf(); leaf; ++leaf) {
        AttributeWriteHandle<T> handle(leaf->attributeArray(name));
        for (Index point = 0; point < leaf->pointCount(); ++point) handle.set(point, value(index++));
    }
}

static void add_attributes(PointDataTree& tree)
{
    add<float, NullCodec>(tree, "pscale", [](int n) { return 0.25f + n % 7; });
    add<Vec3f, NullCodec>(tree, "v", [](int n) { return Vec3f(n, 1, -n / 4.f); });
    add<int32_t, NullCodec>(tree, "id", [](int n) { return n - 3; });
    add<int64_t, NullCodec>(tree, "big", [](int n) { return (int64_t(1) << 40) + n; });
    add<bool, NullCodec>(tree, "flag", [](int n) { return n % 3 == 0; });
    add<float, TruncateCodec>(tree, "short", [](int n) { return n % 100 / 4.f; });
    add<float, FixedPointCodec<true, UnitRange>>(tree, "unit", [](int n) { return n % 5 / 5.f; });
    add<Vec3f, UnitVecCodec>(tree, "N", [](int n) { return Vec3f(n % 3 - 1, n % 5 - 2, 1).unit(); });
    appendAttribute<float>(tree, "constant", 7.5f);
    appendAttribute<Name>(tree, "name");
    appendGroup(tree, "odd"); // before the descriptor is taken, because this replaces it
    MetaMap& strings = makeDescriptorUnique(tree)->getMetadata();
    StringMetaInserter inserter(strings);
    inserter.insert("water");
    inserter.insert("oil");
    for (auto leaf = tree.beginLeaf(); leaf; ++leaf) {
        StringAttributeWriteHandle names(leaf->attributeArray("name"), strings);
        GroupWriteHandle odd = leaf->groupWriteHandle("odd");
        for (Index point = 0; point < leaf->pointCount(); ++point) {
            if (point % 3) names.set(point, point % 3 == 1 ? "oil" : "water");
            odd.set(point, point % 2 == 1);
        }
    }
}

template <typename Codec>
static PointDataGrid::Ptr made(size_t count, const math::Transform& transform, float extent, bool has_attributes)
{
    std::vector<Vec3R> positions;
    for (size_t point = 0; point < count; ++point) {
        const float x = random_number(), y = random_number(), z = random_number();
        positions.push_back(extent * Vec3R(x - 0.5, y - 0.5, z - 0.5));
    }
    auto grid = createPointDataGrid<Codec, PointDataGrid>(positions, transform);
    grid->setName("fluid");
    if (has_attributes) add_attributes(grid->tree());
    return grid;
}

template <typename T>
static void print(std::ostream& out, const AttributeArray& array, Index point)
{
    out << ' ' << AttributeHandle<T>(array).get(point);
}

static void print_points(std::ostream& out, const PointDataGrid& grid)
{
    for (auto leaf = grid.tree().cbeginLeaf(); leaf; ++leaf) {
        AttributeHandle<Vec3f> positions(leaf->constAttributeArray("P"));
        const auto& descriptor = leaf->attributeSet().descriptor();
        for (auto at = leaf->beginIndexOn(); at; ++at) {
            const Vec3d world = grid.indexToWorld(Vec3d(positions.get(*at)) + at.getCoord().asVec3d());
            out << "x " << world.x() << "|y " << world.y() << "|z " << world.z();
            for (const auto& [name, index] : descriptor.map()) {
                const AttributeArray& array = leaf->constAttributeArray(index);
                const Name type = array.valueType();
                if (name == "P" || isGroup(array)) continue;
                out << '|' << name;
                if (isString(array)) out << ' ' << StringAttributeHandle(array, descriptor.getMetadata()).get(*at);
                else if (type == "float") print<float>(out, array, *at);
                else if (type == "int32") print<int32_t>(out, array, *at);
                else if (type == "int64") print<int64_t>(out, array, *at);
                else if (type == "bool") print<bool>(out, array, *at);
                else {
                    const Vec3f value = AttributeHandle<Vec3f>(array).get(*at);
                    out << ' ' << value.x() << ' ' << value.y() << ' ' << value.z();
                }
            }
            for (const auto& [name, bit] : descriptor.groupMap()) out << '|' << name << ' ' << leaf->groupHandle(name).get(*at);
            out << '\n';
        }
    }
}

static void write(const std::string& path, const GridPtrVec& grids, uint32_t compression)
{
    io::File file(path + ".vdb");
    file.setCompression(compression);
    file.write(grids);
    file.close();
    std::ofstream out(path + ".txt");
    out << std::setprecision(12);
    for (const auto& grid : grids) {
        if (auto found = gridPtrCast<PointDataGrid>(grid)) print_points(out, *found);
    }
}

int main(int, char** arguments)
{
    initialize();
    const std::string folder = std::string(arguments[1]) + "/";
    const uint32_t blosc = io::COMPRESS_BLOSC | io::COMPRESS_ACTIVE_MASK, zip = io::COMPRESS_ZIP | io::COMPRESS_ACTIVE_MASK;
    auto plain = math::Transform::createLinearTransform(0.1), moved = math::Transform::createLinearTransform(0.25);
    moved->postTranslate(Vec3d(10, -20, 30));
    math::Transform scaled(math::MapBase::Ptr(new math::ScaleTranslateMap(Vec3d(0.5, 0.25, 0.125), Vec3d(1, 2, 3))));
    FloatGrid::Ptr floats = FloatGrid::create(3);
    floats->setName("density");
    floats->tree().setValue(Coord(1, 2, 3), 1);
    write(folder + "null", {made<NullCodec>(300, *plain, 4, true)}, blosc);
    write(folder + "fixed8", {made<Codec8>(200, *moved, 4, false)}, io::COMPRESS_NONE);
    write(folder + "fixed16", {made<Codec16>(5000, *plain, 3, true)}, zip);
    write(folder + "truncated", {made<TruncateCodec>(500, scaled, 1000, true)}, blosc);
    write(folder + "two", {made<NullCodec>(100, *plain, 4, true), floats, made<Codec16>(60, *moved, 4, true)}, blosc);
}
